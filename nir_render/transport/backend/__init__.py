"""Which Mitsuba variant renders, and which LLVM it compiles with."""
