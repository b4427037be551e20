"""READY sequences: what objects are assembled of, selections of kernels as texts, the layout of the paper's authors."""
