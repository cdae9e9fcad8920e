"""From factors and errors of some places to the error of every place (definitions, section 6).

```
factors --+                     protocols (who judges) --> evaluation (Table IV, opponents)
          +--> dataset --> models --+--> intervals, domain, reasons --> training --> model_file
errors  --+
```

The only room that knows scikit-learn and skops.
"""
