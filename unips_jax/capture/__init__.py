"""Looks at photographs before an estimate: masks, movement, light, exposure."""
