"""What one job of a campaign does: renders, perceives, follows, and says what came of it in rows."""
