"""The learner: networks, storage, learning algorithms, training, self-play and the command line.

It knows spaces and the contract of environments, and no concrete environment. Import it as
`megastep.agents`; in the repository the folder lies beside `megastep/`.
"""

if __name__ == "agents":
    raise ImportError(
        "this package is imported as megastep.agents: write `from megastep.agents import ...` "
        "(`agents` is the import name of another distribution, openai-agents)"
    )
