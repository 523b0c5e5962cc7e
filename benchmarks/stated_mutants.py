"""Further wrong changes: of what an answer is said to be worth, and of what is stated before a search."""

from __future__ import annotations

from benchmarks.mutant import Mutant

# None of the tests that there were noticed these.
MISSED = (
    Mutant("J01", "deviations of structured models on whole records never raised where misfit exceeds noise",
        "inflation = 1.0 if as_stated else inflation_of(test, records_of(test, structure, unknowns), unknowns)",
        "inflation = 1.0",
        "test_slopes::test_deviations_of_whole_records_grow_with_what_is_left_beyond_the_stated_noise"),
    Mutant("J02a", "rows of whole records without the derivative of a mode's scale",
        'd_scale = np.einsum("kdc,kd->kc", d_gamma, estimate.gamma)',
        'd_scale = 0 * np.einsum("kdc,kd->kc", d_gamma, estimate.gamma)',
        "test_slopes::test_rows_of_whole_records_are_those_of_their_modes"),
    Mutant("J02b", "rows of whole records in the estimate's scale where a force gives it",
        "scale, d_scale = np.sign(scale), np.zeros_like(d_scale)", "pass",
        "test_slopes::test_rows_of_whole_records_are_those_of_their_modes"),
    Mutant("J02c", "rows of whole records with the estimate's sign of a mode left out",
        "scale, d_scale = np.sign(scale), np.zeros_like(d_scale)",
        "scale, d_scale = np.ones_like(scale), np.zeros_like(d_scale)",
        "test_slopes::test_rows_of_whole_records_are_those_of_their_modes"),
    Mutant("J03a", "chi-squared of whole records over its degrees of freedom, halved",
        "return 2 * self.chi2 / self.freedom", "return self.chi2 / self.freedom",
        "test_record_model::test_chi_squared_of_right_modes_and_levels_is_its_degrees_of_freedom"),
    Mutant("J03b", "likelihood of whole records without the density of their spectra",
        "np.sum(np.log(own[:c] * chunk.run.density))", "np.sum(np.log(own[:c]))",
        "test_record_model::test_the_likelihood_is_that_of_the_dense_covariance"),
    Mutant("J04", "scales of the modes counted among what whole records without a force determine",
        "return self.size - (0 if self.force else self.m)", "return self.size",
        "test_record_model::test_unknowns_are_as_many_as_the_records_determine"),
    Mutant("J05", "constraints not asked of another answer",
        "problem.keeps_constraints(x) and problem.objective(x) <= as_good_as(problem, objective)",
        "problem.objective(x) <= as_good_as(problem, objective)",
        "test_other_answers::test_another_answer_keeps_the_constraints"),
    Mutant("J06a", "responses of other answers compared in one direction of the base alone",
        "directions[:, size > _MOVING * size[0]]", "directions[:, :1]",
        "test_other_answers::test_a_difference_in_any_direction_in_which_the_base_moves_is_seen"),
    Mutant("J06b", "force of other answers with half of what couples the base",
        "rigid = G.T @ push + M_S0.swapaxes(1, 2) @ G + M_00 records", "rigid = G.T @ push + M_00; records",
        "test_other_answers::test_differences_do_not_depend_on_the_point_of_the_base_that_motions_are_relative_to"),
)  # fmt: skip
