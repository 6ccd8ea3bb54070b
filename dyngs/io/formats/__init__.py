"""Files of Gaussians that other programs read and write: one module per format, one reader and one
writer for all."""
