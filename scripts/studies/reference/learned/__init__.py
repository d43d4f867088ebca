"""A network that gives the tubes' angles and extensions for a shape: how it is trained, kept and asked.

What is published of it is told in s2j.py, and what had to be guessed.
"""
