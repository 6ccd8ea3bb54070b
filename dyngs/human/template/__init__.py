"""Body templates: files, rest shape, skinning weights, texture atlas."""
