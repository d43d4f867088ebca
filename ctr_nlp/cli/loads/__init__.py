"""Commands on robots that bear a load."""
