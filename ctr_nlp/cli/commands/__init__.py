"""The programs, one a file: arguments in, exit status out."""
