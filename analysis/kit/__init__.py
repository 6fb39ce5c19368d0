"""What every answer's room needs: words, and writing a folder."""
