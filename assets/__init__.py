"""Files that ship with masiv: pretrained laws (installed) and the sample scene (in the repository)."""
