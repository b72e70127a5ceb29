"""Physics that the model may lack, one file an effect. ``masiv.effects.catalogue`` finds them."""
