"""Arguments that share a line of a docstring, `a, b: text`, stay together in the API pages."""

import re

import griffe

# An entry of Args or Attributes: names, a comma between them, and a colon.
SHARED = re.compile(r"^ +\w+(?:, \w+)+:", re.M)


class SharedNames(griffe.Extension):
    """Keep Griffe from taking what follows the first space for a type."""

    def on_object(self, *, obj, **options):
        """Join such names by spaces that do not part them."""
        if obj.docstring is not None:
            obj.docstring.value = SHARED.sub(lambda match: re.sub(r"(?<=,) ", "\u00a0", match[0]), obj.docstring.value)
