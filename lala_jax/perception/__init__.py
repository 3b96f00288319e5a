"""From posed depth images to top-down maps: pure functions on arrays."""
