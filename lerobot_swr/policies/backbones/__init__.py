"""What a style policy learns actions with: a `Backbone`, chosen by ``--policy.backbone.type``.

* `backbone`: the contract, which knows neither a cookbook nor a similarity.
* `registry`: the configurations to choose from. A new backbone is one class that fulfils the contract and one
  configuration that is registered there and makes it; importing the module of the configuration, as
  `lerobot_swr.policies.configuration_swr` does with the default's, makes it known. Every LeRobot policy is
  there, too.
* `traits`: what a style policy takes over from its backbone, `own_traits` from one of these, `policy_traits`
  from a LeRobot policy.
* `configuration_mlp`, `modeling_mlp`: a deep ReLU network, the paper's, and the default.
* `wrapped_policy`: a LeRobot policy as a backbone. `style_place` says where in it the style goes, which
  `style_probe` tries and `source_reading` may know before; `redrawn_rows` weights frames for losses that are
  a mean only; `plain_checkpoint` begins from the policy's weights without styles.
"""
