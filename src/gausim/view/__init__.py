"""Playing with a learned object: forces, sessions of them, and what shows them."""
