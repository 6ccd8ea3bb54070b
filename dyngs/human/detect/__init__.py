"""Detection of people, their masks and key points in images."""
