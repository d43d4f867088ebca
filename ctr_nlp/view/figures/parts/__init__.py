"""What pictures share: page, colours, panels and axes in space."""
