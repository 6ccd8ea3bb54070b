"""Per-image corrections learned during training: exposure, camera refinement and robust masks."""
