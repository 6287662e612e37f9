"""What sources say: the optical language, and decoders that read it out of tracks' signals."""
