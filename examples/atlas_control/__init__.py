"""Control across the charts of an atlas: laws handed over, a blended law that is passive, and runs in MuJoCo."""
