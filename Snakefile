# Entry of the workflow: configuration, rules and targets. The mathematics is in siq/, the steps are in
# workflow/rules/, what a study asks is in config/studies/.
from snakemake.utils import min_version

from workflow.places import configuration

min_version("9.0")


# Beside this file, or yours of that name in the folder in which you work.
configfile: configuration(given=bool(workflow.overwrite_configfiles))


include: "workflow/rules/common.smk"
include: "workflow/rules/statistics.smk"
include: "workflow/rules/landscape.smk"
include: "workflow/rules/pages.smk"
include: "workflow/rules/equations.smk"
include: "workflow/rules/cases.smk"
include: "workflow/rules/mismatch.smk"
include: "workflow/rules/proof_common.smk"
include: "workflow/rules/proof.smk"


report: "workflow/report/workflow.rst"


localrules:
    statistics,
    examples,
    reproduce,


rule statistics:
    default_target: True
    input:
        expand("results/{study}/report.html", study=STUDIES.default_names()),


rule examples:
    input:
        "results/double-well/report.html",
        "results/archetype3d-recordings/report.html",


rule reproduce:
    input:
        "results/reproduction.html",
