"""The command nir-render: what is typed becomes one call, and what comes back is shown."""
