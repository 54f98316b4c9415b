"""How near a video is to another: pictures, motion, and the table of scores."""
