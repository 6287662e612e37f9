"""The stage that measures a source as it is built, and leaves it as one that scenes use."""
