"""What several test modules share; imported as `fieldwork.tests.nerfcore.support`."""
