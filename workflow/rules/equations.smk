# Studies `from: equations`: the card alone, without a simulation, recordings or training; and along parameters.


ruleorder: equations > collect
ruleorder: equations_page > page
ruleorder: equations_invariant > invariant


use rule run_task as equations with:
    input:
        card=card_if_any,
    output:
        **tables("landscape", "degrees", "certificates", "outcomes"),
        quasipotential="results/{study}/quasipotential.json",
    log:
        "results/{study}/logs/equations.log",
    benchmark:
        "results/{study}/benchmarks/equations.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    params:
        **task("equations"),
    message:
        "{wildcards.study}: finding the landscape of the equations"


use rule invariant as equations_invariant with:
    input:
        card=card_if_any,
        quasipotential="results/{study}/quasipotential.json",
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),


use rule page as equations_page with:
    input:
        **tables("landscape", "degrees", "certificates", "outcomes"),
        card=card_if_any,
        quasipotential="results/{study}/quasipotential.json",
        sweep=with_sweep("sweep"),
        branches=with_sweep("branches"),
        bifurcations=with_sweep("bifurcations"),
        bifurcation_curves=with_sweep("bifurcation_curves"),
        invariant=with_invariant("results/{study}/tables/invariant.parquet"),
        well_shares=with_invariant("results/{study}/tables/well_shares.parquet"),
        density=with_invariant("results/{study}/drawn/invariant"),
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    params:
        **task("equations_page"),
        captions=CAPTIONS,  # of Snakemake's own report


use rule run_task as sweep_point with:
    input:
        card=card_if_any,
    output:
        point="results/{study}/sweep/{point}.json",
    log:
        "results/{study}/logs/sweep/{point}.log",
    benchmark:
        "results/{study}/benchmarks/sweep/{point}.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
        point=r"\w+=[-+.e\d]+(,\w+=[-+.e\d]+)?",
    params:
        **task("sweep_point"),
    message:
        "{wildcards.study}: the landscape at {wildcards.point}"


use rule run_task as sweep with:
    input:
        card=card_if_any,
        points=points_of_sweep,
    output:
        **tables("sweep", "sweep_ways", "branches"),
        **tables("bifurcations", "bifurcation_curves"),
    log:
        "results/{study}/logs/sweep.log",
    benchmark:
        "results/{study}/benchmarks/sweep.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    params:
        **task("sweep"),
    message:
        "{wildcards.study}: branches, barriers and times against the parameter"
