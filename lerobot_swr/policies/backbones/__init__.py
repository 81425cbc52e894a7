"""What a style policy learns actions with: a `Backbone`, chosen by ``--policy.backbone.type``.

* `backbone`: the contract, which knows neither a cookbook nor a similarity.
* `registry`: the configurations to choose from. A new backbone is one class that fulfils the contract and one
  configuration that is registered there and makes it; importing the module of the configuration, as
  `lerobot_swr.policies.configuration_swr` does with the default's, makes it known.
* `configuration_mlp`, `modeling_mlp`: a deep ReLU network, the paper's, and the default.
"""
