"""Values of policies in an imagined world, beside their true ones."""
