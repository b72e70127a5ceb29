"""masiv: digital twins of moving, deforming objects, from multi-view video or tracked points."""

__version__ = "0.1.0"
