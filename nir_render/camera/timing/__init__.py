"""What a row of pixels collects over time: shutter, drives, exposure control."""
