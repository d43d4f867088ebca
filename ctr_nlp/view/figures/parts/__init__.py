"""Parts that figures share: page, colours, panels and axes in space."""
