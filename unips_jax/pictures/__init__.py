"""Pictures to look at: sheets, normal maps, error maps."""
