"""Forward models of other laboratories beside ours: how a program of theirs is asked, and how far it agrees."""
