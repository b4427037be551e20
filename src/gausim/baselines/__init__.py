"""Methods for comparison, with the same protocol of dynamics."""
