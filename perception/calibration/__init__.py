"""From frames at known ranges to constants."""
