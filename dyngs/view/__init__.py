"""The viewer: a local page that shows scenes, drawn by dyngs and streamed as images."""
