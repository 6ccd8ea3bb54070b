"""Networks that predict people from a few views."""
