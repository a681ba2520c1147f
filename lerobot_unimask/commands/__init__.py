"""The commands of `unimask`, a light file each: `add` makes the parser; heavy imports wait until it runs."""
