"""What each knob of a run costs in quality and brings in speed and size, measured; and the best run within limits."""
