"""How fast the library is: rows timed alone or beside another commit's, growth, peers, what is not compiled.

Times are those of the thread, or of all processes of a program, so that what else runs counts little.
"""
