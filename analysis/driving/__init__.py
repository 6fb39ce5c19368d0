"""What shall the robots do now, and what will come of it? A mission that is driven, by lines of JSON or from Python."""
