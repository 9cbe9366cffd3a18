# Everything in the paper on one page, with ours beside it.


rule reproduction:
    input:
        summaries=expand("results/{study}/tables/summary.parquet", study=REPRODUCED),
        reports=expand("results/{study}/report.html", study=REPRODUCED),
        published=of_reproduced("published"),
        cards=of_reproduced("card"),
        contents=str(config_path("published", "contents.yaml")),
        parameters=str(config_path("published", "parameters.yaml")),
        contradictions=str(config_path("published", "contradictions.yaml")),
    output:
        html="results/reproduction.html",
        csv="results/reproduction.csv",
    log:
        "results/logs/reproduction.log",
    benchmark:
        "results/benchmarks/reproduction.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("reproduction.py"),
        names=REPRODUCED,
        settings=reproduced_settings,
    message:
        "writing the page of the reproduction"
    script:
        "../scripts/reproduction.py"
