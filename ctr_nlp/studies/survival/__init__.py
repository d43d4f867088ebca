"""How plans of many airways survive robots that are not quite known: plain, at several margins, and robust."""
