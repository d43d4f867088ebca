"""Plan a robot's way along a bronchus, all frames at once; print how well it follows, and save the plan."""

import ctr_nlp as ctr

problem = ctr.named_problem("bronchus", frames=20)
plan = ctr.solve_horizon(problem).check()  # looks at the wall, stability and 200 simulated robots

found = ctr.summary(plan)
print(f"{problem.frames} frames, e3 {found['e3']:.2f} mm, last tip {found['tip_last']:.2f} mm off")
for verdict in plan.verdicts:
    print(f"{verdict.matter}: {verdict.word}. {verdict.why}")

plan.save("bronchus.npz")
print("wrote bronchus.npz; `ctr-nlp report bronchus.npz` makes a page of it")
