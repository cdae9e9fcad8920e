"""From factors and errors of some places to the error of every place (definitions, section 6).

```
factors --+            splits (what is held out) --> evaluation (Table IV, opponents)
          +--> join --> dataset --+--> registry: physics, corrected, forest, baselines
errors  --+                       +--> intervals, domain, explain --> training --> file, prediction
                                  +--> figures, bootstrap, repeats: how good, and how sure that is
```

A regressor is one file, which says all about itself, and a line of `registry.py`. Only this folder
knows scikit-learn and skops.
"""
