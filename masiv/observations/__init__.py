"""What was observed, of pictures or of tracks, behind one interface."""
