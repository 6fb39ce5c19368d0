"""Topics, schemas, messages and layouts for viewers of recordings."""
