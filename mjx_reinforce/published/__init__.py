"""Programs of published documents, with what is wrong in them, and augmented random search."""
