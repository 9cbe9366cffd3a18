# Studies `from: equations`: the card alone, without a simulation, recordings or training.


ruleorder: equations > collect
ruleorder: equations_page > page
ruleorder: equations_invariant > invariant


rule equations:
    input:
        card=card_if_any,
    output:
        quasipotential="results/{study}/quasipotential.json",
        landscape="results/{study}/tables/landscape.parquet",
        degrees="results/{study}/tables/degrees.parquet",
        certificates="results/{study}/tables/certificates.parquet",
        outcomes="results/{study}/tables/outcomes.parquet",
    log:
        "results/{study}/logs/equations.log",
    benchmark:
        "results/{study}/benchmarks/equations.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("equations.py"),
        settings=settings_of(EquationSettings),
        card=card_says,
    message:
        "{wildcards.study}: finding the landscape of the equations"
    script:
        "../scripts/equations.py"


rule equations_invariant:
    input:
        card=card_if_any,
        quasipotential="results/{study}/quasipotential.json",
    output:
        table="results/{study}/tables/invariant.parquet",
        shares="results/{study}/tables/well_shares.parquet",
        drawn=directory("results/{study}/drawn/invariant"),
    log:
        "results/{study}/logs/invariant.log",
    benchmark:
        "results/{study}/benchmarks/invariant.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("invariant.py"),
        settings=settings_of(InvariantSettings),
        card=card_says,
    message:
        "{wildcards.study}: computing the invariant distribution"
    script:
        "../scripts/invariant.py"


rule equations_page:
    input:
        card=card_if_any,
        quasipotential="results/{study}/quasipotential.json",
        landscape="results/{study}/tables/landscape.parquet",
        degrees="results/{study}/tables/degrees.parquet",
        certificates="results/{study}/tables/certificates.parquet",
        outcomes="results/{study}/tables/outcomes.parquet",
        sweep=with_sweep("sweep"),
        branches=with_sweep("branches"),
        bifurcations=with_sweep("bifurcations"),
        bifurcation_curves=with_sweep("bifurcation_curves"),
        invariant=with_invariant("results/{study}/tables/invariant.parquet"),
        well_shares=with_invariant("results/{study}/tables/well_shares.parquet"),
        density=with_invariant("results/{study}/drawn/invariant"),
    output:
        html=report(
            "results/{study}/report.html",
            caption="../report/report.rst",
            category="{study}",
            subcategory=ANSWER,
            labels={"shows": "The page: everything in one file", "kind": "page"},
        ),
        figures=report(
            directory("results/{study}/figures"),
            patterns=["{name}.svg"],
            caption="../report/figure.rst",
            category="{study}",
            subcategory=figure_part,
            labels=figure_labels,
        ),
        answer="results/{study}/answer.json",
    log:
        "results/{study}/logs/page.log",
    benchmark:
        "results/{study}/benchmarks/page.tsv"
    wildcard_constraints:
        study=STUDIES.pattern_of("equations"),
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("equations_page.py"),
        command=lambda wildcards: study_of(wildcards).command(),
        settings=settings_of(PageSettings),
        card=card_says,
    message:
        "{wildcards.study}: writing the page"
    script:
        "../scripts/equations_page.py"
