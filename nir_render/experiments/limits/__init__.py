"""What the paper's conclusion leaves open: where threats break the system, and what wins it back."""
