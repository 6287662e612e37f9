"""Light straight from small sources, or by one flat mirror: closed form, only the visibility is traced."""
