"""Methods to compare with; each offers the same contract of dynamics."""
