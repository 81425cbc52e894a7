"""What a style policy learns actions with: a `Backbone`, chosen by ``--policy.backbone.type``.

Every LeRobot policy, a plugin's too, is one without any code here: it is registered with LeRobot. One of
this package's own sees the present numbers of an observation and learns the present action (`OwnTraits`);
what sees pictures or windows, or plans chunks, is better written as a LeRobot policy.

* `backbone`: the contract, which knows neither a cookbook nor a similarity.
* `registry`: the configurations to choose from. A new backbone is one class that fulfils the contract and one
  configuration that is registered there and makes it; importing the module of the configuration, as
  `lerobot_swr.policies.backed_config` does with the default's, or a plugin with its own, makes it known.
* `traits`: what a style policy takes over from its backbone, `own_traits` from one of these, `policy_traits`
  from a LeRobot policy.
* `configuration_mlp`, `modeling_mlp`: a deep ReLU network, the paper's, and the default; `objects`: inputs as
  seen from the things that an observation tells of.
* `wrapped_policy`: a LeRobot policy as a backbone. `style_place` says where in it the style goes, which
  `style_probe` tries and `source_reading` may know before; `redrawn_rows` weights frames for losses that are
  a mean only; `plain_checkpoint` begins from the policy's weights without styles.
"""
