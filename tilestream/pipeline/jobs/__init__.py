"""The jobs: which stages apply where."""
