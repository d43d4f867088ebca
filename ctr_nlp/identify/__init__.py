"""Which robot this is: tubes from measured shapes (`calibration`), and sensors while it moves (`closed_loop`)."""
