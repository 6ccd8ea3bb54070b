"""3D Gaussian splatting of static scenes, with the filters of Mip-Splatting."""
