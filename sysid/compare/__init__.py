"""Methods side by side on one problem: the strategies of the package, and optimisers of others."""
