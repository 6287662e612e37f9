"""Two runs, or two estimators of one run, frame by frame: whether a change helped."""
