"""Looks at a data set before hours of training are spent on it, and says what is wrong and how to mend it."""
