"""Body templates, their texture atlas, and skinning."""
