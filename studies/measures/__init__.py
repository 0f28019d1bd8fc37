"""What the page "What is measured" reports, part by part."""
