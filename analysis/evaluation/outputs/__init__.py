"""The optional outputs of `evaluate`."""
