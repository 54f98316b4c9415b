"""The steps of the pipeline: one frozen dataclass each, from artifacts to an artifact."""
