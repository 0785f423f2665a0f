"""A module a family of inputs; importing it registers its generators."""
