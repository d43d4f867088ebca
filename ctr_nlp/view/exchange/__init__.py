"""Exchange with other programs: plans written as their files, their configurations and robots read. Knows no
machines and no options.
"""
