"""What clearance costs and brings: plans without and with it, over many airways."""
