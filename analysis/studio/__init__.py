"""The studio: a local page to paint on a map, with a new result after every stroke (`mrac-jax studio`)."""
