"""Which ways of doing the task are in a dataset? Found without a rule, then used as one.

* `paths`: episodes as paths of a common number of points, walked at a common pace.
* `features`: what an episode is compared by: its path, standardised, with or without what its scene explains.
* `clusters`: groups of episodes, and how many of them the data support.
* `outliers`: episodes that fit nowhere, and why.
* `discover`: the way from a dataset's episodes to its behaviours.
* `rule`: the result as a file, ``behaviors.json``, and as a behaviour rule that labels new episodes.
* `frames`: pictures of an episode, where there are cameras.
* `report`: one HTML page that shows the behaviours and lets a person name them.
"""
