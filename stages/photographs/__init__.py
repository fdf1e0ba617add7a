"""What the photographs of a scene say of a map of it. ground: both, opened; calibrate: gains and errors; pyramid: scales;
posterior: the albedo that they share; prior: what the network says of its own errors; intervals: how far unseen images lie;
copying: a map once more.
"""
