"""From a residual to the effect that the model lacks. The stage is ``masiv.refinement.stage.refine``."""
