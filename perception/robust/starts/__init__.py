"""Where fits begin: first guesses of flares, and which of them are worth following."""
