"""Plan a motion along a bronchus, all frames at once; print its errors and verdicts, and save the plan."""

import ctr_nlp as ctr

problem = ctr.named_problem("bronchus", frames=20)
plan = ctr.solve_horizon(problem).check()  # on the elastic model and on 200 simulated robots

errors = ctr.summary(plan)
print(f"{problem.frames} frames, e3 {errors['e3']:.2f} mm, tip {errors['tip_last']:.2f} mm from the target's end")
for verdict in plan.verdicts:
    print(f"{verdict.matter}: {verdict.word}. {verdict.why}")

plan.save("bronchus.npz")
print("wrote bronchus.npz; `ctr-nlp report bronchus.npz` makes a page of it")
