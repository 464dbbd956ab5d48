"""The learner: networks from spaces, storage of rollouts, learning algorithms, training, self-play, and
the command line.

It knows spaces and the contract of environments, and no concrete environment. The package is
imported as ``megastep.agents``; the folder lies beside ``megastep/`` in the repository.
"""

if __name__ == "agents":
    raise ImportError(
        "this package is imported as megastep.agents: write `from megastep.agents import ...` "
        "(`agents` is the import name of another distribution, openai-agents)"
    )
