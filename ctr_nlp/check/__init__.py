"""Check plans a second time: from plan.npz and the equations alone, without any other module of the package."""
