"""From films to frames of one clock: reading them, and what tells when they began."""
