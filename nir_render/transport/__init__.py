"""How light travels: the only room that imports Mitsuba."""
