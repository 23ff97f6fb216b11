"""Three coupled tanks with two pumps."""
