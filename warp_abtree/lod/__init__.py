"""Selection of LODs (section 4 of the paper): view, controllers and the timing that they read."""
