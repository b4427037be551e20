"""The embedded synthetic set: bodies that MuJoCo moves, covered with Gaussians."""
