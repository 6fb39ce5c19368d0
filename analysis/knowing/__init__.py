"""The answer of `reproduce online` and `moving`: what does it cost not to know the map, or where its threats are?"""
