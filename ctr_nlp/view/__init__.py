"""What people and other programs see of a plan: figures, a page, a live view in the browser, files of other
programs.
"""
