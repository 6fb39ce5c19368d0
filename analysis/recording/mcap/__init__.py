"""The container: MCAP written, read, scanned and mended."""
