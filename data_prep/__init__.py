"""Scripts that make or pack data sets; they use gausim, gausim never uses them."""
