"""A network that maps a shape to the tubes' angles and extensions: how it is trained, stored and evaluated.

It follows Liang et al., S2J-IK, 2022; s2j.py says what is published of it and what had to be guessed.
"""
