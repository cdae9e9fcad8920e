"""From factors and errors of some places to the error of every place (definitions, section 6).

```
factors --+            splits (what is held out) --> evaluation (Table IV, opponents)
          +--> join --> dataset --+--> registry: forest, physics, baselines (each a regressor)
errors  --+                       +--> intervals, domain, explain --> training --> file
```

A regressor is one file, which says all about itself, and a line of `registry.py`. Only this folder
knows scikit-learn and skops.
"""
