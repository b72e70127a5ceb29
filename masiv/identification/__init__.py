"""From a trajectory to a twin: initial velocity, ground, law. The stage is ``masiv.identification.stage.identify``."""
