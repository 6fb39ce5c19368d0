"""What the viewers draw: topics, schemas, messages, layouts."""
