"""Networks that the `transformers` library has, behind the priors' protocols.

The library is an extra and imported where it is used. Weights come from folders on this machine as the hub keeps them
(`config.json`, `model.safetensors` and, for text, `tokenizer.json`); nothing is fetched, and nothing is unpickled.
"""
