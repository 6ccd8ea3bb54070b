"""Detection of people and key points in images."""
