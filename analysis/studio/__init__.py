"""What does painting on the map change? A local page that answers every stroke (`mrac-jax studio`)."""
