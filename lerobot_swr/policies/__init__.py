"""BC, ZBC and WZBC as LeRobot's configuration / modeling / processor trio; `baselines` beside them.

A style policy (`style_policy`) is a cookbook of styles, a backbone (`backbones`) that learns actions, and the
steps that make a lesson (`lessons`). The way of a batch in training:

    batch of LeRobot's loop, preprocessed (`vector_pipelines`): observations, action, episode_index
      |
      v  StylePolicy.draw                       all random draws are here
    Lesson(batch, weight = 1, episode = i, teaches_style = True)
      |  Balance   weight: every episode counts alike, pauses not at all
      |  Correct   (corrective labels) half of the frames: beside a demonstration, leading back to it
      |  Relabel   (wzbc) algorithm 1: the pair (i, j): episode = j, weight W, teaches_style = (i == j)
      v
    Lesson(batch, weight, episode, teaches_style)
      |
      v  StylePolicy.loss                       pure: of the parameters and the lesson
    z = cookbook[episode], detached where not teaches_style
      |
      v  Backbone.loss(batch, z, weight)        knows no cookbook and no similarity
    mean loss, and each frame's

Seeds that are trained as one (`lerobot_swr.training`) take `draw` of many steps and `loss`, and nothing else.
To act, `select_action` draws a style per environment from the cookbook and asks the backbone.

What comes from the training dataset is read in `training_data` when the policy is created; `dynamics` fits
what corrective labels need; `lerobot_swr.styles.held_out` encodes episodes that are not trained on;
`style_checkpoints` and `checked_loading` tell what of a checkpoint goes on. `optimizer_swr` optimizes
all three; where there are very many styles, `row_adam` steps those that move.
"""
