"""A scene as arrays and as what Mitsuba loads."""
