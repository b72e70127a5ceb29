"""Scenes from own footage: videos or folders of pictures, a calibration, and how their clocks agree."""
