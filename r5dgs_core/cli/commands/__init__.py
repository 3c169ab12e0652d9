"""Commands of ``r5dgs``, one per module; `cli.registry` lists them."""
