"""The avatar: Gaussians on a body template, posed by its skeleton."""
