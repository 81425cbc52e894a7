"""BC, ZBC and WZBC as LeRobot's configuration / modeling / processor trio; `baselines` beside them.

A style policy (`style_policy`) is a cookbook of styles, a backbone (`backbones`) that learns actions, and the
steps that make a lesson (`lessons`). The way of a batch in training:

    batch of LeRobot's loop, preprocessed (`vector_pipelines`): observations, action, episode_index
      |
      v  StylePolicy.draw                       all random draws are here
    Lesson(batch, weight = 1, episode = i, teaches_style = True)
      |  Balance   weight: every episode counts alike, pauses not at all
      |  Correct   (corrective labels) half of the frames: beside a demonstration, leading back to it
      |  Relabel   (wzbc) algorithm 1: the pair (i, j): episode = j, teaches_style = (i == j);
      |            weighted by W, or drawn by it
      |  Blur      (style_noise) noise on the styles
      v
    Lesson(batch, weight, episode, teaches_style, noise)
      |
      v  StylePolicy._taught                    pure, as all that follows: of the parameters and the lesson
    z = cookbook[episode] (+ noise), detached where not teaches_style
      |
      v  Backbone.loss(batch, z, weight)        knows no cookbook and no similarity
    mean loss, and each frame's

Seeds that are trained as one (`lerobot_swr.training`) take `draw` of many steps and `loss`, and nothing else.
To act, `select_action` draws a style per environment from the cookbook and asks the backbone.

What comes from the training dataset is read in `training_data` when the policy is created; `dynamics` fits
what corrective labels need; `lerobot_swr.styles.held_out` encodes episodes that are not trained on;
`style_checkpoints`, `stored_styles` and `checked_loading` tell what of a checkpoint goes on. `optimizer_swr`
is the optimizer of this package's own backbones; where there are very many styles, `row_adam` steps those
that move. Options are in `state_config`, `backed_config` and `configuration_swr`, from the general to the
particular; `style_making` and `scene_defaults` make of them what the policy consists of.
"""
