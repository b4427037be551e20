"""READY sequences: sources of objects, textual selections of kernels, the layout of the paper's authors."""
