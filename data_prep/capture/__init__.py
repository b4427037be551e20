"""Several cameras' films and photos: one clock, poses, masks."""
