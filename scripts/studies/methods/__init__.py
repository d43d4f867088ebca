"""Methods beside each other, ours and others': what is measured of their plans, and the page that shows it."""
