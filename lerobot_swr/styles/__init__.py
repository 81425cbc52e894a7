"""The styles of a dataset's demonstrations: which there are, which may be drawn, how they are drawn.

* `cookbook`: the trainable styles {z_i}, and those that a rollout uses.
* `embedding`: styles that are coordinates of what ν compares, instead of random beginnings.
* `drawing`: how one is drawn of those that are allowed, `scenes`: by how demonstrations began; `request`:
  those that somebody asks for instead.
* `selection`: which are allowed; `filters`: by what the `table` knows of each demonstration,
  `metric_files`: also from elsewhere.
* `encoding`: styles of demonstrations not trained on; `held_out`: for the held-out loss; `extension`:
  to enlarge a checkpoint's cookbook.
* `report`, `map` with ``map.html``: to look at them.
"""
