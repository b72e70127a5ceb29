"""What a recording will tell of a body, estimated from its motion before anything is fitted."""
