"""One image: lines, whiskers in them, and one whisker followed from frame to frame."""
